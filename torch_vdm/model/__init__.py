"""What is computed: the boxes of Fig. 2, one file each, and their order in `model.py`.

Nothing here knows of sizes of images, devices, compilers or graphs of gradients; that is
`torch_vdm.run`.
"""
