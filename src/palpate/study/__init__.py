"""One case: what it says, what came out of it."""
