"""
Report of a study, as one HTML page or as Markdown with pictures.

``reading`` gathers runs and states, ``facts`` computes their numbers, ``content`` makes the report as data;
``figures``, ``html`` and ``markdown`` write it to files.
"""
