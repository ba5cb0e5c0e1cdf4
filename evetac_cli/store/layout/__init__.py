"""The layout of evetac's files.

schema      contents of each kind of file; checks arrays and files
contents    validity of values: limits of the schema, and rules across datasets
new_contents  the same for a file that is being written
provenance  recipe, recipe id and header: the identity of a result
netcdf      dimensions by name, for xarray
"""
