from forms import any_form  # noqa: F401
