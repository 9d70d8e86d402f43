from .contract import ContractLine as ContractLine
from .contract import match_contracts as match_contracts
from .equations import ClosedForm as ClosedForm
from .interface import Engine as Engine
from .load import load_engine as load_engine
