"""The bus between processes: keys, messages, and zenoh; the only package that imports zenoh."""
