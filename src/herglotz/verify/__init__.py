"""Is it a contact integrator, and does it predict? Every claim measured on a scene, a fit, a file or any L_d."""

from herglotz.verify.report import Check, Report
from herglotz.verify.verifier import verify

__all__ = ["Check", "Report", "verify"]
