"""The paper's errata, one function each: the printed formula's residual beside the corrected one's."""

from __future__ import annotations

from collections.abc import Callable

from paper_errata.application import e9
from paper_errata.contact_maps import e1, e2, e3, e4, e5
from paper_errata.erratum import Erratum
from paper_errata.hamilton_jacobi import e6, e7, e8, e10

ERRATA: tuple[Callable[[], Erratum], ...] = (e1, e2, e3, e4, e5, e6, e7, e8, e9, e10)
