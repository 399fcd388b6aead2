"""Analysis of a controller on models: responses, Bode of L, S, T, gain sensitivity, what-if."""
