"""Pictures and films of runs and scenes, and plots of audits."""
