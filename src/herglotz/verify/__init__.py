"""Checks that a scene, a run, a file or any L_d is a contact integrator, and that a run predicts its data."""

from herglotz.verify.report import Check as Check, Report as Report
from herglotz.verify.verifier import symmetries as symmetries, verify as verify
