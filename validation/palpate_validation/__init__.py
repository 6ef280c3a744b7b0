"""References for Palpate's numbers: problems with known answers, and the paper's experiments.

Two tables of scenes (`scenes.py`): `palpate verify` computes the problems of `problems/` (`verify.py` names them all),
`palpate reproduce` the experiments of `paper/` (`reproduce.py`). Palpate itself imports nothing from here.
"""
