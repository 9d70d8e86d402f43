from .audit_place import Finding as Finding
from .certificate import Certificate as Certificate
from .certificate import certify_jacobian as certify_jacobian
from .certify import RolloutCertificate as RolloutCertificate
