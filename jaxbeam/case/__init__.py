"""The case: beam, supports, loads, actuators, sensors; interfaces of controllers and estimators."""
