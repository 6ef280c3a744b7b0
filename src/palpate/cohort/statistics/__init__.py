"""What the moduli of a cohort have to do with its patients' stages, with a named unit of analysis."""
