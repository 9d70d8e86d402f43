from . import quantities as quantities
from .contract import Contract as Contract
from .inputs import BodyForce as BodyForce
from .soft_contact import SoftContact as SoftContact
from .soft_contact import softened as softened
