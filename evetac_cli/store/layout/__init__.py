"""What a file of evetac holds.

schema      what a file of each kind holds; checks arrays and files
contents    whether values make sense: limits of the schema, and rules across datasets
new_contents  the same for a file that is being written
provenance  recipe, recipe id and header: the identity of a result
netcdf      dimensions by name, for xarray
"""
