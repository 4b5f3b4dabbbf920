"""What a user describes: beam, loads, actuators, sensors, controller and estimator interfaces."""
