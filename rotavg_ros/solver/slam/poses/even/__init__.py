"""Units in which errors are alike along all axes."""
