"""The library faery, the extra `convert`: loading it, and telling its refusals from errors that are not its own."""

from typing import Any

from evetac_cli.errors import InputError


def load_faery(what: str, where: str) -> Any:
    """The module faery; InputError that says for `what` it is needed where it is not installed or does not load."""
    try:
        import faery
    except ImportError as error:
        hint = "pip install '.[convert]'"
        raise InputError(f"{what} faery", where=where, found=str(error), hint=hint) from None
    return faery


def refusal_text(error: BaseException) -> str:
    """The first line of what faery says; raises again what faery did not mean to say, such as KeyboardInterrupt.

    A panic of faery's Rust is a BaseException of a type that cannot be imported.
    """
    if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
        raise error
    return (str(error).splitlines() or [type(error).__name__])[0][:200]
