"""Import of OpenDRIVE maps as towns (https://www.asam.net/standards/detail/opendrive/, versions 1.x).

Start reading at `importing`. It reads from the map what SUMO's importer leaves out (`document`), lets netconvert split
the map into nodes, edges and connections, rewrites these as streets with sidewalks (`streets`), lets netconvert join
them to a net, and derives the town's parameters from it (`furnishing`, `georeference`). `objects` reads what stands or
is painted along the roads, such as crosswalks and signal heads.
"""
