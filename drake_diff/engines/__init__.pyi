from .contract_line import ContractLine as ContractLine
from .contract_match import match_contracts as match_contracts
from .equations import ClosedForm as ClosedForm
from .interface import Engine as Engine
from .load import load_engine as load_engine
