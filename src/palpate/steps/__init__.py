"""What the commands do, as functions: the command line and Python take the same steps."""
