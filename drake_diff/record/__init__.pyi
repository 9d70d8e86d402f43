from .certification import CertificationRecord as CertificationRecord
from .certification import certify_model as certify_model
from .comparison import ComparisonRecord as ComparisonRecord
from .phases import PhasesRecord as PhasesRecord
from .robustness import RobustnessRecord as RobustnessRecord
from .sealed import SealedRecord as SealedRecord
from .solve import EvidenceRecord as EvidenceRecord
