from .step import StepDerivatives as StepDerivatives

METHODS: tuple[str, ...]
