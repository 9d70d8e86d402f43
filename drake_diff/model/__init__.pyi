from .assembly import assembled as assembled
from .contact import SoftContact as SoftContact
from .contact import contact_modes as contact_modes
from .contact import softened as softened
from .contract import Contract as Contract
from .inputs import BodyForce as BodyForce
from .step import StepCount as StepCount
from .step import count_steps as count_steps
