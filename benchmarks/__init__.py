"""Studies of accuracy, honesty and speed; `python -m benchmarks` lists them."""
