#version 300 es
// endotwin's light on tissue: light/forward.py and light/shading.py, in the same words.
precision highp float;
precision highp int;
in vec3 point, normal, base;
in float rough, mirrored;
out vec4 shown;

const float PI = 3.14159265358979, COS_MIN = 1e-4, ROUGHNESS_MIN = 0.045, RADIANCE_MIN = 1e-6;
uniform float L0, n, q, profile, gamma, tone, f0, burley, roughness, exposure;
uniform float coat_f0, coat_roughness, coat_tail;
uniform vec2 vignetting;   // k2, k4
uniform vec4 image;        // fx, fy, cx, cy in px
uniform vec2 size;         // width and height, px
uniform vec3 guides_mm[8];
uniform int guides;

float pow5(float x) { return x * x * x * x * x; }

float gtr(float sin2_m, float alpha, float tail) {
  float a2 = min(alpha * alpha, 0.9999), log_width = -log(a2), stretch = (tail - 1.0) * log_width;
  float norm = (1.0 - a2) / log_width * (stretch < 1e-3 ? 1.0 : stretch / (exp(stretch) - 1.0));
  return norm / (PI * pow(sin2_m + a2 * (1.0 - sin2_m), tail));
}

float half_smith(float cosine, float alpha) {
  return cosine + sqrt(alpha * alpha * (1.0 - cosine * cosine) + cosine * cosine);
}

float lobe(float cos_i, float cos_o, float sin2_m, float r, float tail) {
  float alpha = max(r, ROUGHNESS_MIN);
  alpha *= alpha;
  return gtr(sin2_m, alpha, tail) / (half_smith(cos_i, alpha) * half_smith(cos_o, alpha));
}

float diffuse(float cos_i, float cos_o, float cos_d, float r) {
  float fi = pow5(1.0 - cos_i), fo = pow5(1.0 - cos_o), retro = 2.0 * r * cos_d * cos_d;
  return (1.0 - fi / 2.0) * (1.0 - fo / 2.0) + retro * (fi + fo + fi * fo * (retro - 1.0));
}

vec3 radiance(vec3 facing, float r) {
  vec3 wo = normalize(-point), x = vec3(0.0);
  float cos_o = clamp(dot(facing, wo), COS_MIN, 1.0);
  for (int k = 0; k < guides; k++) {
    vec3 towards = guides_mm[k] - point;
    float distance_mm = max(length(towards), 1e-3);
    vec3 wi = towards / distance_mm, wm = normalize(wi + wo), across = cross(facing, wm);
    float cos_i = max(dot(facing, wi), COS_MIN), cos_d = dot(wi, wm), cos_axis = max(-wi.z, COS_MIN);
    float log_axis = (1.0 - profile) * log(cos_axis) + profile * (cos_axis - 1.0);
    float strength = exp(log(L0) + n * log_axis - q * log(distance_mm)) * cos_i * 2.0 * PI / float(guides);
    float sin2_m = dot(across, across);
    x += strength / PI * mix(1.0, diffuse(cos_i, cos_o, cos_d, r), burley) * base;
    x += strength * f0 * lobe(cos_i, cos_o, sin2_m, r, 2.0);
    x += strength * coat_f0 * lobe(cos_i, cos_o, sin2_m, coat_roughness, coat_tail);
  }
  return x;
}

void main() {
  vec2 pixel = image.xy * point.xy / point.z + image.zw;
  vec2 off = (pixel - (size - 1.0) / 2.0) / (max(size.x, size.y) / 2.0);
  float r2 = dot(off, off);
  float passed = exposure * exp(vignetting.x * r2 + vignetting.y * r2 * r2);
  vec3 facing = faceforward(normal, point, normal);  // the back of a sliver at a rim is no black dot
  vec3 x = passed * (radiance(normalize(facing), clamp(rough * roughness, 0.0, 1.0)) + mirrored);
  vec3 untoned = min(exp(gamma * log(x + RADIANCE_MIN)) - exp(gamma * log(RADIANCE_MIN)), 1.0);
  shown = vec4(mix(untoned, untoned * untoned * (3.0 - 2.0 * untoned), tone), 1.0);
}
