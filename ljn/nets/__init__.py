"""Networks: tensors in, tensors out. No loss, no logging, no files."""
