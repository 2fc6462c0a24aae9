"""The features of a potential as C, product by product, and what of the other features C does not know."""

from __future__ import annotations

from herglotz.errors import InputError
from herglotz.export.c_template import number
from herglotz.models import ContactLagrangian
from herglotz.models.feature_kinetic import FeatureKinetic
from herglotz.models.feature_potential import FeaturePotential
from herglotz.models.features import Product


def check_terms(model: ContactLagrangian) -> None:
    """Raise for the terms that have no C.

    Raises
    ------
    InputError
        Naming the term and the format that holds it.
    """
    missing = {
        "features of the velocity": isinstance(model.kinetic, FeatureKinetic),
        "coupled friction": model.coupling is not None,
        "the rule of order 4": model.config.order == 4,
    }
    for term, there in missing.items():
        if there:
            raise InputError(f"{term} cannot be written as C yet; export the model as .pt2 instead")


def feature_lines(potential: FeaturePotential, dtype: str) -> list[str]:
    """V->value and V->slope of the features, added to what is there."""
    lines: list[str] = []
    weights = potential.sum.weights().detach().cpu().double().tolist()
    for product, weight in zip(potential.sum.products, weights, strict=True):
        lines += ["{", *(f"  {line}" for line in _one(product, weight, potential.sum.dof, dtype)), "}"]
    return lines


def _one(product: Product, weight: float, dof: int, dtype: str) -> list[str]:
    if product.function == "radius":
        square = " + ".join(f"q[{i}] * q[{i}]" for i in range(dof))
        bend = number(weight * product.power, dtype)
        return [
            f"const real r = SQRT({square});",
            f"const real slope = {bend} * {_power('r', product.power - 2)};",
            f"V->value += {number(weight, dtype)} * {_power('r', product.power)};",
            *(f"V->slope[{i}] += slope * q[{i}];" for i in range(dof)),
        ]
    form = [(i, w) for i, w in enumerate(product.form) if w]
    if not form:  # the feature `1`, which moves s alone
        constant = {"cos": 1.0, "sin": 0.0, "power": float(product.power == 0)}[product.function]
        return [f"V->value += {number(weight * constant, dtype)};"]
    y = " + ".join(f"{number(w, dtype)} * q[{i}]" for i, w in form)
    value, bend, slope = {
        "cos": ("COS(y)", -weight, "SIN(y)"),
        "sin": ("SIN(y)", weight, "COS(y)"),
        "power": (_power("y", product.power), weight * product.power, _power("y", product.power - 1)),
    }[product.function]
    return [
        f"const real y = {y};",
        f"const real slope = {number(bend, dtype)} * {slope};",
        f"V->value += {number(weight, dtype)} * {value};",
        *(f"V->slope[{i}] += {number(w, dtype)} * slope;" for i, w in form),
    ]


def _power(x: str, exponent: int) -> str:
    """A whole power written out."""
    if exponent == 0:
        return "SPREAD(1.0)"
    product = " * ".join([x] * abs(exponent))
    return f"({product})" if exponent > 0 else f"(R(1.0) / ({product}))"
