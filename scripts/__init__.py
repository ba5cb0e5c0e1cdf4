"""Programs of the repository, which is on Python's path once evetac is installed from it: `python scripts/.../X.py`.

- reproduce: the experiments, their tables in docs/results, checks of these, the freeze and the seeds
- paper: the rows of the paper beside evetac's figures
- studies: a folder for each study beyond the paper's experiments
- benchmark: evetac-bench
- speed: run times and costs, of kernels, commands and stages
- attack: damaged files and streams, kills, other users
- docs, pictures: pages made from the code, checks of the built site; film, strips, screenshots
- ship: models put into the package
"""
