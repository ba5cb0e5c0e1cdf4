"""Our own files on disk: the only package that imports h5py for them.

schema      what a file of each kind holds; checks arrays and files
contents    whether values make sense: limits of the schema, and rules across datasets
new_contents  the same for a file that is being written
provenance  recipe, recipe id and header: the identity of a result
disk        new files, all or nothing, also where the disk is full
checked_hdf5  the one door to HDF5 files, ours and other people's: what is read was checked there first
hdf5_text   texts of an HDF5 file, read from its bytes
files       open, check, skip and write files of all kinds
segments    recordings that grow: closed segments, joined at the end
recovery    what can be made of the segments of a recording that broke off
read        the reading API for Python: recordings as slices, features as a data set
calibration dot grids as JSON
index       what each file of a data set is, in one SQLite file
"""
