"""R, L and K of a winding whose voltage is measured, not held: the balance of one instant, or of one mean."""
