"""Studies of many trainings: their specification, what can be trained together, and the results."""
