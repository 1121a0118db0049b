"""A renderer that shares nothing with endotwin: random colons, lights and cameras, as sequences with their
truth.

    wall      a closed surface given as a grid, and rays to it
    colon     the shape of a random lumen           mucosa     its albedo and roughness
    path      where the camera goes                 lens       which ray each pixel sees along
    light     lamps, diffuse and glossy reflection  gloss      what lobes reflect of their surroundings
    radiosity light that tissue throws on tissue    shapes     walls with a closed form, for tests
    scene     everything drawn from a seed          picture    radiance of frames, and photos
    shown     what each effect changes in the photos, after the best fit of the rest
    write     a folder in C3VD's layout, with truth/made.json

Lengths are in millimetres. The world is the colon's; camera frames follow OpenCV (x right, y down, z
forward), pixel centres are at integers. Formulas are written from their sources, with numpy; Embree only
answers which triangle a ray meets.

Left out: from patch to patch all but the lamps' light travels as if all reflection were diffuse; a coat adds
its highlight and takes nothing from what is under it; guides are points, so that shadows are hard; the photos
are neither sharpened nor compressed.
"""
