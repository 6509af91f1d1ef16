"""Many chains: in threads, over ranks."""
