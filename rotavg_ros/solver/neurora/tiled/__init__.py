"""The networks as solves run them: the formulas of ``message_passing``, ``clean_net`` and ``fine_net`` in tiles."""
