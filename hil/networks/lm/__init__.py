"""Levenberg–Marquardt for multilayer perceptrons: our own, batched, on the CPU or a GPU.

`hil.networks.lm.train.train` fits B networks of one layout (`network.Mlp`) to B targets;
`regressor.LevenbergMarquardtRegressor` is the same with scikit-learn's contract. Why it is fast is
said in docs/explanation/levenberg-marquardt.md.
"""
