"""Data inserted into a page."""

import json

from l2dgs_jax.runtime.pages import filled, script_json


def test_placeholders_are_replaced_and_replacements_left_alone():
    assert filled("<p>__TITLE__</p>__MY_DATA__", title="__MY_DATA__", my_data="$x __proto__") == (
        "<p>__MY_DATA__</p>$x __proto__"
    )


def test_no_text_in_the_data_ends_its_script_element():
    data = {"</script><!--": ["<", "</SCRIPT>", 1.5, None]}
    assert "<" not in script_json(data)
    assert json.loads(script_json(data)) == data
