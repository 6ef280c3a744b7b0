"""The paper's experiments again: its tables, its figure and its cohort, with our numbers beside its own."""
