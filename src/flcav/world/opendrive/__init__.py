"""Towns from OpenDRIVE maps (https://www.asam.net/standards/detail/opendrive/, versions 1.x).

`importing` is where to start: it reads what SUMO's importer leaves out (`document`), has netconvert take the map
apart, writes its streets anew with sidewalks (`streets`), has netconvert join them to a net, and furnishes that
(`furnishing`).
"""
