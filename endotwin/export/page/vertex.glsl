#version 300 es
// Camera frame as in OpenCV: x right, y down, z forward; mm.
precision highp float;
layout(location = 0) in vec4 place;   // position in the mesh's box, and roughness, 0 to 1
layout(location = 1) in vec2 facing;  // normal, octahedral (Cigolle et al. 2014)
layout(location = 2) in vec4 color;   // square root of the linear base colour
uniform vec3 low, extent, centre;     // the box, and the camera in the mesh's frame
uniform mat3 turn;                    // from the mesh's frame to the camera's
uniform vec4 lens;                    // 2fx/w, 2fy/h, (2cx + 1)/w - 1, (2cy + 1)/h - 1
uniform vec2 fit, range_mm;
out vec3 point, normal, base;
out float rough;

vec3 unfolded(vec2 e) {
  vec3 n = vec3(e, 1.0 - abs(e.x) - abs(e.y));
  if (n.z < 0.0) n.xy = (1.0 - abs(n.yx)) * vec2(n.x < 0.0 ? -1.0 : 1.0, n.y < 0.0 ? -1.0 : 1.0);
  return normalize(n);
}

void main() {
  point = turn * (low + place.xyz * extent - centre);
  normal = turn * unfolded(facing);
  base = color.rgb * color.rgb;
  rough = place.w;
  float near = range_mm.x, far = range_mm.y;
  vec2 seen = lens.xy * point.xy + lens.zw * point.z;
  float depth = ((far + near) * point.z - 2.0 * far * near) / (far - near);
  gl_Position = vec4(fit.x * seen.x, -fit.y * seen.y, depth, point.z);
}
