"""What the model lacks: torque and voltage that would explain the residuals, by a smoother."""
