"""The file formats of rasters and images, one module each, and what a plugin needs to bring one more.

A format of rasters is a `nodegraph.Format` of the type `Raster`, or of one role.  Reading at once is the simple way::

    def read(path: Path) -> Elevation:
        return Elevation(np.loadtxt(path), Extent(0, 0, 100, 100))

    def write(surface: Raster, name: str) -> File:
        return File.of(name, ...)

    @hookimpl
    def nodegraph_formats():
        return [Format(Raster, (".heights",), "plain numbers", read, write)]

A file whose head tells its shape is better opened: what `open` yields, a `nodegraph_terrain.formats.contents.Contents`,
says what stands in the file and reads some rows when asked.  Then a plan knows what memory the file takes, tiles are
read piece by piece, and a cancel takes effect between them::

    @contextmanager
    def open_heights(path: Path) -> Iterator[Contents]:
        cells = np.memmap(path, "<f4", "r", offset=16, shape=...)
        yield Contents(*cells.shape, cells.dtype, lambda rows: cells[rows], unit="ft")

Either way the parameters of terrain.load_elevation that hold for every file (extent, crs, nodata, vertical_unit and so
on) are applied to what comes out.  A reader that names others of them (``band``, ``rows``, ``columns``, ``byte_order``)
as keyword parameters gets them; so does a writer with ``minimum`` and ``maximum`` of terrain.save_elevation, which are
refused for one without.
"""
