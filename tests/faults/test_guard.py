import pytest

from planner_jax.sims.guard import is_allowed

NAMES = {"localhost", "127.0.0.1"}


@pytest.mark.parametrize(
    ("headers", "path", "token", "allowed"),
    [
        ({"Host": "localhost:8080"}, "/", None, True),
        ({"Host": "[::1]:8080"}, "/", None, True),
        ({"Host": "localhost:8080", "Origin": "http://localhost:8080"}, "/", None, True),
        ({"Host": "localhost:8080", "Origin": "http://other.example"}, "/", None, False),
        ({"Host": "localhost:8080", "Origin": "http://localhost:9000"}, "/", None, False),
        ({"Host": "localhost:8080", "Origin": "null"}, "/", None, False),
        ({"Host": "other.example:8080", "Origin": "http://other.example:8080"}, "/", None, False),
        ({}, "/", None, False),
        ({"Host": "10.0.0.7:8080"}, "/", "abc", False),
        ({"Host": "10.0.0.7:8080"}, "/?token=x", "abc", False),
        ({"Host": "10.0.0.7:8080"}, "/?token=", "abc", False),
        ({"Host": "10.0.0.7:8080"}, "/?token=abc", "abc", True),
        ({"Host": "10.0.0.7:8080", "Cookie": "a=b; planner-jax=abc"}, "/x.js", "abc", True),
        ({"Host": "10.0.0.7:8080", "Cookie": "planner-jax=é"}, "/x.js", "abc", False),
        ({"Host": "10.0.0.7:8080", "Origin": "http://other.example"}, "/?token=abc", "abc", False),
    ],
)
def test_pages_of_the_viewer_s_own_origin_and_with_its_token_are_allowed(
    headers, path, token, allowed
):
    assert is_allowed(headers, path, NAMES, token) is allowed
