"""Reports to look at: figures and self-contained pages."""
