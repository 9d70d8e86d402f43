from .certification import CertificationRecord as CertificationRecord
from .certification import certify_model as certify_model
from .run_record import EvidenceRecord as EvidenceRecord
