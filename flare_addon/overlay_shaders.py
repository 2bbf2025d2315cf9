# SPDX-License-Identifier: GPL-3.0-or-later
"""The shaders of the overlay: for the quads of Gaussians, and for the sum of the buffers. `overlay` compiles them."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def gaussian_shader() -> Any:
    """Compile the shader that draws the quads of Gaussians (`overlay.Quads`).

    Its push constants are size, that of the level in pixels, and is_over, 1 for the blend "over", else 0. Pixels below
    the rasterizer's thresholds ALPHA_MIN and PROFILE_MIN (core/conventions/splatting.py) are discarded.
    """
    import gpu

    flow = gpu.types.GPUStageInterfaceInfo("fit_flare_gaussian")
    flow.smooth("VEC2", "position")
    flow.flat("VEC3", "colour")
    flow.flat("VEC3", "ring_shape")
    flow.flat("VEC3", "arc_shape")
    info = gpu.types.GPUShaderCreateInfo()
    info.push_constant("VEC2", "size")
    info.push_constant("FLOAT", "is_over")
    info.vertex_in(0, "VEC2", "place")
    info.vertex_in(1, "VEC2", "local")
    info.vertex_in(2, "VEC3", "light")
    info.vertex_in(3, "VEC3", "ring")
    info.vertex_in(4, "VEC3", "arc")
    info.vertex_out(flow)
    info.fragment_out(0, "VEC4", "result")
    info.vertex_source("void main() {\n"
                       "  position = local; colour = light; ring_shape = ring; arc_shape = arc;\n"
                       "  vec2 ndc = place / size * 2.0 - 1.0;\n"
                       "  gl_Position = vec4(ndc.x, -ndc.y, 0.0, 1.0);\n"
                       "}\n")
    info.fragment_source("void main() {\n"
                         "  float radius = sqrt(max(dot(position, position), 1e-12));\n"
                         "  float deviations = (radius - ring_shape.x) / ring_shape.y;\n"
                         "  float log_arc = dot(arc_shape.xy, position) - arc_shape.z;\n"
                         "  float profile = exp(log_arc - 0.5 * deviations * deviations);\n"
                         "  float alpha = is_over > 0.5 ? profile * ring_shape.z : 1.0;\n"
                         "  if (is_over > 0.5 ? alpha < 1.0 / 255.0 : profile < 1.0 / 4096.0) { discard; }\n"
                         "  result = vec4(colour * profile, alpha);\n"
                         "}\n")
    return gpu.shader.create_from_info(info)


def sum_shader(levels: Sequence[int]) -> Any:
    """Compile the shader that adds up the buffers of levels, given by the divisors of their size.

    Its vertices are corners of the part of the region that is drawn, 0..1 of the region. Its push constants, at most
    128 bytes, are box, where the region lies (left, bottom, right, top, 0..1 of the framebuffer); extent, the size of
    the region in pixels; drawn, the sum of 2 ** number for each level that is added; is_display, 1 where the buffers
    hold display values; and working_space, the matrix from linear Rec. 709.
    """
    import gpu

    flow = gpu.types.GPUStageInterfaceInfo("fit_flare_sum")
    flow.smooth("VEC2", "position")
    info = gpu.types.GPUShaderCreateInfo()
    info.push_constant("VEC4", "box")
    info.push_constant("VEC2", "extent")
    info.push_constant("INT", "drawn")
    info.push_constant("FLOAT", "is_display")
    info.push_constant("MAT4", "working_space")
    for number in range(len(levels)):
        info.sampler(number, "FLOAT_2D", f"level{number}")
    info.vertex_in(0, "VEC2", "corner")
    info.vertex_out(flow)
    info.fragment_out(0, "VEC4", "result")
    info.vertex_source("void main() {\n"
                       "  position = corner;\n"
                       "  gl_Position = vec4(mix(box.xy, box.zw, corner) * 2.0 - 1.0, 0.0, 1.0);\n"
                       "}\n")
    # Texels are filtered here, so that the result does not depend on the settings of a texture. The size of a level is
    # rounded up, so its rows are counted from the top, where the picture begins.
    full = "texelFetch(level{number}, min(ivec2(position * extent), ivec2(extent) - 1), 0).rgb"
    reduced = "bilinear(level{number}, extent / {divisor}.0)"
    samples = "".join(f"  if ((drawn & {1 << number}) != 0) {{\n    sum += "
                      + (full if divisor == 1 else reduced).format(number=number, divisor=divisor)
                      + ";\n  }\n" for number, divisor in enumerate(levels))
    info.fragment_source("vec3 bilinear(sampler2D picture, vec2 covered) {\n"
                         "  ivec2 size = textureSize(picture, 0);\n"
                         "  float y = float(size.y) - (1.0 - position.y) * covered.y;\n"
                         "  vec2 texel = vec2(position.x * covered.x, y) - 0.5;\n"
                         "  ivec2 low = ivec2(floor(texel));\n"
                         "  vec2 weight = texel - vec2(low);\n"
                         "  ivec2 last = size - 1;\n"
                         "  vec3 a = texelFetch(picture, clamp(low, ivec2(0), last), 0).rgb;\n"
                         "  vec3 b = texelFetch(picture, clamp(low + ivec2(1, 0), ivec2(0), last), 0).rgb;\n"
                         "  vec3 c = texelFetch(picture, clamp(low + ivec2(0, 1), ivec2(0), last), 0).rgb;\n"
                         "  vec3 d = texelFetch(picture, clamp(low + ivec2(1, 1), ivec2(0), last), 0).rgb;\n"
                         "  return mix(mix(a, b, weight.x), mix(c, d, weight.x), weight.y);\n"
                         "}\n"
                         "void main() {\n"
                         "  vec3 sum = vec3(0.0);\n" + samples +
                         "  sum = max(sum, vec3(0.0));\n"
                         "  if (is_display > 0.5) {\n"  # display values to linear light
                         "    sum = mix(sum / 12.92, pow((sum + 0.055) / 1.055, vec3(2.4)), "
                         "step(vec3(0.04045), sum));\n"
                         "  }\n"
                         "  result = vec4(mat3(working_space) * sum, 1.0);\n"
                         "}\n")
    return gpu.shader.create_from_info(info)
