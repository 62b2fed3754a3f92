// Directions in the frame of a normal.
#pragma once

#include <cmath>

#include "common.h"

namespace univoxel {

/// The frame of Duff et al. 2017 around a unit normal, which is its +Z. V is a vector of three: of
/// GLM, or float3 in loops that vectorise.
template <class V>
struct Frame {
    using T = decltype(V::x);

    V tangent, bitangent, normal;
    T sign, a;

    explicit Frame(const V& n) : normal(n), sign(std::copysign(T(1), n.z)) {
        a = -1 / (sign + n.z);
        const T b = n.x * n.y * a;
        tangent = {1 + sign * n.x * n.x * a, sign * b, -sign * n.x};
        bitangent = {b, sign + n.y * n.y * a, -n.y};
    }

    V to_local(const V& w) const { return {dot(tangent, w), dot(bitangent, w), dot(normal, w)}; }
    V to_world(const V& u) const { return u.x * tangent + u.y * bitangent + u.z * normal; }

    /// Gradient to the normal from those to the three vectors.
    V backward(const V& grad_tangent, const V& grad_bitangent, const V& grad_normal) const {
        const T x = normal.x, y = normal.y;
        const T grad_b = sign * grad_tangent.y + grad_bitangent.x;
        const T grad_a = grad_tangent.x * sign * x * x + grad_bitangent.y * y * y + grad_b * x * y;
        return grad_normal +
               V(2 * grad_tangent.x * sign * x * a - sign * grad_tangent.z + grad_b * y * a,
                 2 * grad_bitangent.y * y * a - grad_bitangent.z + grad_b * x * a, grad_a * a * a);
    }
};

}  // namespace univoxel
