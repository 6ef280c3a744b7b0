"""The demo, the paper's tables and the problems with known answers."""
