"""Statistics of experiments: intervals, times to solve with unsolved runs, scores over tasks, comparisons of methods.

Pure functions of arrays. The unit is the run: two episodes of one policy are not two samples.
"""
