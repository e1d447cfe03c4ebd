"""The bus between processes: keys, messages, and zenoh. No other package imports zenoh."""
