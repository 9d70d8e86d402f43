from .verify import Verification as Verification
