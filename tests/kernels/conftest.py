from forms import any_form, any_way  # noqa: F401
