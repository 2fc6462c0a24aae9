"""Terms of several coordinates in exchange for others: what one of them stands for may be said better by another."""

from __future__ import annotations

from collections.abc import Callable

from herglotz.training.found_terms import Found
from herglotz.training.named_terms import DRY, NamedTerms


def exchanged(
    found: Found,
    every: NamedTerms,
    refit: Callable[[Found, NamedTerms], Found | None],
    missing: Callable[[Found], str | None],
    floor: float,  # misfits below are rounding
) -> Found:
    """Each term is left out, and the one that is missing most then joins, where that is as likely.

    Elimination and joining one by one keep a term that came first: (q1 + q2)⁴ for (q1 − q2)⁴ where two masses move
    together, or a term that only a worse fit needed. Terms whose absence would double the squared misfit, by the
    quadratic model of the fit, are not asked, and none where residuals are no noise.
    """
    data = found.fit.problem.data
    if data.dof == 1 or found.coloured:
        return found
    firm = found.needed(data.q.numel(), (), floor).names
    for name in found.terms.names:
        less = None if name in (*firm, DRY) else refit(found, found.terms.only(set(found.terms.names) - {name}))
        if less is None or less.as_likely(found, floor):
            found = less or found
            continue
        other = missing(less)
        more = None if other in (None, DRY, name) else refit(less, every.only((*less.terms.names, other)))
        found = more if more is not None and more.as_likely(found, floor) else found
    return found
