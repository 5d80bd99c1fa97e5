"""Properties of the equations of a traced function, nested ones included."""

import jax
from jax import lax

PRODUCTS = {"dot_general", "conv_general_dilated"}
HIGHEST = (lax.Precision.HIGHEST, lax.Precision.HIGHEST)


def assert_full_precision(function, *args):
    """Assert that every matrix product of `function(*args)` requests `Precision.HIGHEST`.

    With less, a GPU rounds the factors of a float32 product to TF32. Derivatives are functions
    of their own: check `jax.grad(function)` as well. Returns the number of products, so that a
    test can assert that there are any.
    """
    products = [
        equation
        for equation in equations(jax.make_jaxpr(function)(*args))
        if equation.primitive.name in PRODUCTS
    ]
    for product in products:
        shapes = " and ".join(str(operand.aval) for operand in product.invars)
        assert product.params["precision"] == HIGHEST, (
            f"{product.primitive} of {shapes} asks for precision {product.params['precision']}"
        )
    return len(products)


def equations(jaxpr):
    """Yield all equations of a jaxpr and of those inside it: loops, branches, solves, calls."""
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
