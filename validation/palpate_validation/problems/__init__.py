"""Problems with known answers: what the mechanics and the estimator are checked against."""
