"""Docstrings and names keep the project's rules of language, counted by `tests/language.py`."""

from language import find_participles, find_phrases, share_of_imperatives


def test_docstrings_of_functions_begin_with_a_verb():
    share, others = share_of_imperatives()
    assert share >= 0.99, "\n".join(others)


def test_sentences_have_their_nouns():
    found = find_phrases()
    assert len(found) <= 40, "\n".join(found)


def test_no_function_is_named_by_a_bare_participle():
    assert not find_participles()
