"""How good poses, masks and results are, against what is known."""
