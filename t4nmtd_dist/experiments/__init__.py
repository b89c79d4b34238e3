"""The paper's experiments: which arms they compare, a resumable queue of runs, tables and figures."""
