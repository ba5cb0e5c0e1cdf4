"""Assert that lines of code and statements are counted as the table says."""

from scripts.count_code import size_of

MODULE = '''"""A docstring
of two lines."""

import os  # with a comment

# a comment

def name() -> str:
    """Another docstring."""
    text = """a string of
    two lines"""
    return text + os.name
'''


def test_comments_and_docstrings_are_no_code() -> None:
    """Assert that a string which is no docstring counts, and that comments, docstrings and blank lines do not."""
    assert size_of(MODULE) == (1, 5, 6)
