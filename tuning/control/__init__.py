"""Controllers tuned by gradients through the closed loop."""
