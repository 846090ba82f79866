"""Studies of many trainings: what is to be trained, what can be trained together, and what came out."""
