"""A renderer that shares nothing with endotwin: random colons, lights and cameras, as sequences with their
truth.

    wall      a closed surface given as a grid, and rays to it
    colon     the shape of a random lumen           mucosa     its albedo and roughness
    path      where the camera goes                 lens       which ray each pixel sees along
    gloss     reflected surroundings
    light     lamps, diffuse and glossy reflection  radiosity  light that tissue throws on tissue
    scene     everything drawn from a seed          picture    radiance of frames, and photos
    shown     what each effect changes in the photos, after the best fit of the rest
    write     a folder in C3VD's layout, with truth/made.json

Lengths are in millimetres. The world is the colon's; camera frames follow OpenCV (x right, y down, z
forward), pixel centres are at integers. Formulas are written from their sources, with numpy; Embree only
answers which triangle a ray meets.
"""
