"""Several processes, each with a device of its own, that train one model: `torch.distributed`, and how it ends."""
