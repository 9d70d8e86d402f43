from . import quantities as quantities
from .contact import contact_modes as contact_modes
from .contract import Contract as Contract
from .counted import StepCount as StepCount
from .counted import count_steps as count_steps
from .inputs import BodyForce as BodyForce
from .soft_contact import SoftContact as SoftContact
from .soft_contact import softened as softened
