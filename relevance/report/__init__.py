"""What people look at: the report, the dataset card, their tables and plots."""
