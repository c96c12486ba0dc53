"""Where and in which precision kernels run."""
