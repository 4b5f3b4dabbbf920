"""Model: modes, modal model, contact law, output rows, state space, statics, frequency response."""
