"""What is not a defect of the program."""


class UserError(Exception):
    """Something the user can mend. Its message is one line that names what is wrong and what is accepted; commands show
    that line alone."""


def one_line(error: BaseException) -> str:
    """The kind and the message of an exception that others raised."""
    return f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
