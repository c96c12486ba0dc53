"""Figures and tables of the paper, one module each: `run(out_dir, small)`."""
