from .step import StepDerivatives as StepDerivatives
