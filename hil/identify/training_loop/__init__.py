"""Training networks by gradient: stages, early stopping, checkpoints; PyTorch is imported late."""
