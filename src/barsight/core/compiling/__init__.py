"""Keep the kernels' machine code on disk, and compile it ahead in several processes."""
