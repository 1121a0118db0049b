#version 300 es
// Camera frame as in OpenCV: x right, y down, z forward; mm.
precision highp float;
precision highp int;
layout(location = 0) in vec4 place;   // position in the mesh's box, and roughness, 0 to 1
layout(location = 1) in vec2 facing;  // normal, octahedral (Cigolle et al. 2014)
layout(location = 2) in vec4 color;   // square root of the linear base colour
layout(location = 3) in vec2 level;   // normal of the film of fluid, octahedral
layout(location = 4) in float weight; // of the film
uniform vec3 low, extent, centre;     // the box, and the camera in the mesh's frame
uniform mat3 turn;                    // from the mesh's frame to the camera's
uniform vec4 lens;                    // 2fx/w, 2fy/h, (2cx + 1)/w - 1, (2cy + 1)/h - 1
uniform vec2 fit, range_mm;
uniform float L0, n, q, profile, film_f0, film_roughness;
uniform vec3 guides_mm[8];
uniform int guides;
out vec3 point, normal, base;
out float rough, mirrored;            // radiance that the film mirrors, which endotwin interpolates, too

vec3 unfolded(vec2 e) {
  vec3 n = vec3(e, 1.0 - abs(e.x) - abs(e.y));
  if (n.z < 0.0) n.xy = (1.0 - abs(n.yx)) * vec2(n.x < 0.0 ? -1.0 : 1.0, n.y < 0.0 ? -1.0 : 1.0);
  return normalize(n);
}

// light/film.py
float film(vec3 facing) {
  float x = 0.0, a2 = pow(film_roughness, 4.0);
  if (weight * film_f0 == 0.0) return x;
  for (int k = 0; k < guides; k++) {
    vec3 towards = guides_mm[k] - point;
    float distance_mm = max(length(towards), 1e-3);
    vec3 wi = towards / distance_mm, across = cross(facing, normalize(wi - normalize(point)));
    float s = dot(across, across), cos_axis = max(-wi.z, 1e-4);
    s += a2 * (1.0 - s);
    float log_axis = (1.0 - profile) * log(cos_axis) + profile * (cos_axis - 1.0);
    x += exp(log(L0) + n * log_axis - q * log(distance_mm)) * a2 / (s * s) / 2.0 / float(guides);
  }
  return weight * film_f0 * x;
}

void main() {
  point = turn * (low + place.xyz * extent - centre);
  normal = turn * unfolded(facing);
  base = color.rgb * color.rgb;
  rough = place.w;
  mirrored = film(turn * unfolded(level));
  float near = range_mm.x, far = range_mm.y;
  vec2 seen = lens.xy * point.xy + lens.zw * point.z;
  float depth = ((far + near) * point.z - 2.0 * far * near) / (far - near);
  gl_Position = vec4(fit.x * seen.x, -fit.y * seen.y, depth, point.z);
}
