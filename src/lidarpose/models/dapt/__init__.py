"""The paper's own network, DAPT, in plain torch: it loads the released weights and trains anew.

`config` sizes and names, `curves` and `tables` numpy only, `layers` and `network` torch, `released` the authors' files.
"""
