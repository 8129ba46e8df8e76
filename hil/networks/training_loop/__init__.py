"""Training networks by gradient: stages, early stopping, checkpoints; PyTorch is imported late.

`settings`, `stages`, `curves` and `problem` import no torch; `loss`, `loop`, `steps`, `device` and
`checkpoint` do, and are imported inside functions only.
"""
