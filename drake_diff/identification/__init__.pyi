from .explain import Explanation as Explanation
from .explain import explain as explain
from .identify import Identification as Identification
from .identify import identify as identify
from .impacts import ContactIdentification as ContactIdentification
from .impacts import identify_contact as identify_contact
from .write_model import write_model as write_model
