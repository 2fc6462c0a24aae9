"""Every test of exported files collects and reads the operations of torch.onnx once."""

import pytest


@pytest.fixture(autouse=True, scope="session")
def _registered_once(registered_once):
    """The fixture of the whole suite, here for every test."""
