"""
The report of a study, as one HTML page or as Markdown with pictures.

``reading`` gathers runs and states, ``facts`` computes what is said of them, ``content`` says it, as data; ``figures``,
``html`` and ``markdown`` put that into files.
"""
