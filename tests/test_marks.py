import pytest
from marks import selects_slow


@pytest.mark.parametrize(
    ("expression", "selects"),
    [
        ("", True),
        ("slow or not slow", True),
        ("slow and not gpu", True),
        ("not gpu", True),
        ("gpu", True),
        ("not slow and not gpu", False),
        ("not slow", False),
        ("gpu and not slow", False),
    ],
)
def test_slow_tests_are_selected_unless_the_expression_excludes_them(expression, selects):
    assert selects_slow(expression) == selects
