from .audit import Finding as Finding
from .certificate import Certificate as Certificate
from .certificate import certify_jacobian as certify_jacobian
from .rollout import RolloutCertificate as RolloutCertificate
