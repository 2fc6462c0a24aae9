"""Learnable discrete contact Lagrangians."""

from herglotz.models.capabilities import Capabilities as Capabilities, capabilities as capabilities
from herglotz.models.config import LEVELS as LEVELS, ModelConfig as ModelConfig
from herglotz.models.model import ContactLagrangian as ContactLagrangian, numbers_of as numbers_of
from herglotz.models.own import OwnLagrangian as OwnLagrangian, own_name as own_name, refuse_own as refuse_own
from herglotz.models.term import TERMS as TERMS, Term as Term
