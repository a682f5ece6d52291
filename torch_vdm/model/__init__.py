"""What is computed: the boxes of Fig. 2, one file each, and their order in `model.py`.

Nothing here depends on image size, device, compiler or autograd; that is left to `torch_vdm.run`.
"""
