"""Live view of CPN's simulators, and player of recorded trials and demonstrations, in Rerun's viewer."""
