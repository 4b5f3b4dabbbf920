"""The beam as equations: modes, modal model, contact law, state space, statics, frequency responses."""
