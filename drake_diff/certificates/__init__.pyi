from .certificate import Certificate as Certificate
from .certificate import certify_jacobian as certify_jacobian
from .finding import Finding as Finding
from .functions import FunctionCertificate as FunctionCertificate
from .rollout import RolloutCertificate as RolloutCertificate
