"""Many subjects on many machines: the pipeline as a Snakefile, and what a large run would cost."""
