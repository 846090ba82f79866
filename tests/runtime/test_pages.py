"""Data within a page."""

import json

from l2dgs_jax.runtime.pages import script_json


def test_nothing_in_it_ends_the_element_that_it_stands_in():
    data = {"</script><!--": ["<", "</SCRIPT>", 1.5, None]}
    assert "<" not in script_json(data)
    assert json.loads(script_json(data)) == data
