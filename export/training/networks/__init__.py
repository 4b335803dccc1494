"""Networks: the paper's single-view U-Net and the sparse multi-view predictor."""
