"""Learnable discrete contact Lagrangians."""

from herglotz.models.capabilities import Capabilities, capabilities
from herglotz.models.config import LEVELS, ModelConfig
from herglotz.models.model import ContactLagrangian, DrivenLagrangian, numbers_of
from herglotz.models.term import TERMS, Term

__all__ = [
    "LEVELS", "TERMS", "Capabilities", "ContactLagrangian", "DrivenLagrangian", "ModelConfig", "Term", "capabilities",
    "numbers_of",
]  # fmt: skip
