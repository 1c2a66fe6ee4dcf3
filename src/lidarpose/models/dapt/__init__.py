"""The paper's own network, DAPT, in plain torch: it loads the released weights and can be trained from scratch.

`dapt_config`: sizes and names; `voxel_tables`: numpy only; `dapt_net`: torch; `import_weights`: the authors' files.
"""
