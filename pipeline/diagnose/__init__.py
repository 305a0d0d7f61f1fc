"""What a model misses of measured motions: phases, segments with states of their own, score tests of effects."""
