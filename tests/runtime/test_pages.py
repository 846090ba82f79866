"""Data within a page."""

import json

from l2dgs_jax.runtime.pages import filled, script_json


def test_holes_are_filled_and_what_fills_them_is_left_alone():
    assert filled("<p>__TITLE__</p>__MY_DATA__", title="__MY_DATA__", my_data="$x __proto__") == (
        "<p>__MY_DATA__</p>$x __proto__"
    )


def test_nothing_in_it_ends_the_element_that_it_stands_in():
    data = {"</script><!--": ["<", "</SCRIPT>", 1.5, None]}
    assert "<" not in script_json(data)
    assert json.loads(script_json(data)) == data
