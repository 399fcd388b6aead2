"""A battery of simulated systems whose truth is known; `python benches/battery.py` runs it.

simulators   excitations and plants, sample by sample
families     kinds of systems with parameters drawn by seed; which half each belongs to
references   what a result is held against: the true structure refitted, output error, the noise
scoring      runs of `identify`, their scores, the summary
"""
