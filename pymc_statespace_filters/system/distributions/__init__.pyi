from .finite import FINITE_LAWS, FiniteLaw
from .laws import LAWS, Law, law_name, parameters_of
from .scalar import SCALAR_LAWS

__all__ = ["FINITE_LAWS", "LAWS", "SCALAR_LAWS", "FiniteLaw", "Law", "law_name", "parameters_of"]
