"""The paper's real experiment, rehearsed: recorded, learned from, controlled, all by a server."""
