"""Checks of the operations in the jaxpr of a function, including nested jaxprs."""

import jax
from jax import lax

PRODUCTS = {"dot_general", "conv_general_dilated"}
HIGHEST = (lax.Precision.HIGHEST, lax.Precision.HIGHEST)


def assert_full_precision(function, *args):
    """Assert that every matrix product of `function(*args)` requests `Precision.HIGHEST`.

    At a lower precision a GPU rounds float32 factors to TF32. Check derivatives, such as
    `jax.grad(function)`, by calls of their own. The result is the number of products.
    """
    every = equations(jax.make_jaxpr(function)(*args))
    products = [equation for equation in every if equation.primitive.name in PRODUCTS]
    for product in products:
        shapes = " and ".join(str(operand.aval) for operand in product.invars)
        assert product.params["precision"] == HIGHEST, (
            f"{product.primitive} of {shapes} asks for precision {product.params['precision']}"
        )
    return len(products)


def equations(jaxpr):
    """Yield all equations of a jaxpr, and of the jaxprs of loops, branches and calls inside it."""
    for equation in jaxpr.eqns:
        yield equation
        for inner in inner_jaxprs(tuple(equation.params.values())):
            yield from equations(inner)


def inner_jaxprs(value):
    if hasattr(value, "eqns"):
        yield value
    elif isinstance(value, (tuple, list)):
        for item in value:
            yield from inner_jaxprs(item)
