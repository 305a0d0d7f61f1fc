"""Those who compete in the benchmark `fall_push.py`: each learns from one short motion, then predicts longer ones."""
