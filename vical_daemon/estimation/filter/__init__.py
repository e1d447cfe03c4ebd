"""The unscented filter and what feeds it."""
