#include "visibility.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>
#include <vector>

#include "parallel.h"

#ifdef UNIVOXEL_EMBREE
#if UNIVOXEL_EMBREE >= 4
#include <embree4/rtcore.h>
#else
#include <embree3/rtcore.h>
#endif
#endif

namespace univoxel {
namespace {

constexpr int64_t kRaysPerChunk = 1024;
[[maybe_unused]] const Hit kNoHit{std::numeric_limits<float>::infinity(), 0, 0, -1, {0, 0, 0}};

}  // namespace

#ifdef UNIVOXEL_EMBREE

namespace {

[[noreturn]] void fail(RTCDevice device) {
    throw std::runtime_error("Embree: error " +
                             std::to_string(static_cast<int>(rtcGetDeviceError(device))));
}

RTCRay make_ray(const vec3<float>& o, const vec3<float>& d, float t_min, float t_max) {
    RTCRay ray;
    ray.org_x = o.x, ray.org_y = o.y, ray.org_z = o.z, ray.tnear = t_min;
    ray.dir_x = d.x, ray.dir_y = d.y, ray.dir_z = d.z, ray.time = 0;
    ray.tfar = t_max;
    ray.mask = ~0u, ray.id = 0, ray.flags = 0;
    return ray;
}

// Embree's own bound on coordinates; builds of it that assert would end the process beyond it, and
// NaN would pass through every box.
bool usable(const vec3<float>& o, const vec3<float>& d) {
    const float size = std::abs(o.x) + std::abs(o.y) + std::abs(o.z) + std::abs(d.x) +
                       std::abs(d.y) + std::abs(d.z);
    return size < 1e18f;
}

// Packets of 8 are the fastest for rays that start close by in all directions, also where Embree
// has wider ones.
constexpr int kPacket = 8;

#if UNIVOXEL_EMBREE >= 4
void trace(const int* valid, RTCScene scene, RTCRay8& rays) {
    rtcOccluded8(valid, scene, &rays);
}
void trace(const int* valid, RTCScene scene, RTCRayHit8& rays) {
    rtcIntersect8(valid, scene, &rays);
}
#else
void trace(const int* valid, RTCScene scene, RTCRay8& rays) {
    RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    rtcOccluded8(valid, scene, &context, &rays);
}
void trace(const int* valid, RTCScene scene, RTCRayHit8& rays) {
    RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    rtcIntersect8(valid, scene, &context, &rays);
}
#endif

/// Copy rays from `first` on; the last one again beyond the end of the stream, marked invalid.
void load(const RayStream& rays, int first, RTCRay8& packet, int* valid) {
    for (int k = 0; k < kPacket; ++k) {
        const int i = std::min(first + k, rays.n - 1);
        const vec3<float> o(rays.ox[i], rays.oy[i], rays.oz[i]);
        const vec3<float> d(rays.dx[i], rays.dy[i], rays.dz[i]);
        valid[k] = first + k < rays.n && usable(o, d) ? -1 : 0;
        packet.org_x[k] = o.x, packet.org_y[k] = o.y, packet.org_z[k] = o.z;
        packet.dir_x[k] = d.x, packet.dir_y[k] = d.y, packet.dir_z[k] = d.z;
        packet.tnear[k] = rays.t_min, packet.time[k] = 0;
        packet.tfar[k] = std::numeric_limits<float>::infinity();
        packet.mask[k] = ~0u, packet.id[k] = 0, packet.flags[k] = 0;
    }
}

}  // namespace

struct VisibilityScene::Impl {
    std::vector<float> vertices;  // Embree reads them in place, in loads of 16 bytes
    std::vector<int32_t> faces;
    RTCDevice device = nullptr;
    RTCScene scene = nullptr;
    bool packets = false;  // whether this processor traces several rays in step

    ~Impl() {
        if (scene) rtcReleaseScene(scene);
        if (device) rtcReleaseDevice(device);
    }
};

int embree_version() {
    return UNIVOXEL_EMBREE;
}

VisibilityScene::VisibilityScene(const float* vertices, int64_t n_vertices, const int32_t* faces,
                                 int64_t n_faces, int threads)
    : impl_(std::make_unique<Impl>()) {
    impl_->vertices.assign(vertices, vertices + 3 * n_vertices);
    impl_->vertices.resize(3 * n_vertices + 4);
    impl_->faces.assign(faces, faces + 3 * n_faces);
    for (const int32_t i : impl_->faces) {
        if (i < 0 || i >= n_vertices)
            throw std::invalid_argument("VisibilityScene: faces must index 0 .. " +
                                        std::to_string(n_vertices - 1) + ", got " +
                                        std::to_string(i));
    }
    impl_->faces.resize(3 * n_faces + 4);
    impl_->device = rtcNewDevice(("threads=" + std::to_string(threads)).c_str());
    if (!impl_->device) fail(nullptr);
    impl_->packets =
        rtcGetDeviceProperty(impl_->device, RTC_DEVICE_PROPERTY_NATIVE_RAY8_SUPPORTED) != 0;
    impl_->scene = rtcNewScene(impl_->device);
    // Without it, 2 % of rays aimed at an edge slip through between its triangles.
    rtcSetSceneFlags(impl_->scene, RTC_SCENE_FLAG_ROBUST);
    RTCGeometry mesh = rtcNewGeometry(impl_->device, RTC_GEOMETRY_TYPE_TRIANGLE);
    rtcSetSharedGeometryBuffer(mesh, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3,
                               impl_->vertices.data(), 0, 3 * sizeof(float), n_vertices);
    rtcSetSharedGeometryBuffer(mesh, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3,
                               impl_->faces.data(), 0, 3 * sizeof(int32_t), n_faces);
    rtcCommitGeometry(mesh);
    rtcAttachGeometry(impl_->scene, mesh);
    rtcReleaseGeometry(mesh);
    rtcCommitScene(impl_->scene);
    if (rtcGetDeviceError(impl_->device) != RTC_ERROR_NONE) fail(impl_->device);
}

bool VisibilityScene::occluded(const vec3<float>& origin, const vec3<float>& direction, float t_min,
                               float t_max) const {
    if (!usable(origin, direction)) return false;
    RTCRay ray = make_ray(origin, direction, t_min, t_max);
#if UNIVOXEL_EMBREE >= 4
    rtcOccluded1(impl_->scene, &ray);
#else
    RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    rtcOccluded1(impl_->scene, &context, &ray);
#endif
    return ray.tfar < 0;
}

Hit VisibilityScene::closest_hit(const vec3<float>& origin, const vec3<float>& direction,
                                 float t_min, float t_max) const {
    if (!usable(origin, direction)) return kNoHit;
    RTCRayHit query;
    query.ray = make_ray(origin, direction, t_min, t_max);
    query.hit.geomID = query.hit.instID[0] = RTC_INVALID_GEOMETRY_ID;
#if UNIVOXEL_EMBREE >= 4
    rtcIntersect1(impl_->scene, &query);
#else
    RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    rtcIntersect1(impl_->scene, &context, &query);
#endif
    if (query.hit.geomID == RTC_INVALID_GEOMETRY_ID) return kNoHit;
    return {query.ray.tfar,
            query.hit.u,
            query.hit.v,
            static_cast<int64_t>(query.hit.primID),
            {query.hit.Ng_x, query.hit.Ng_y, query.hit.Ng_z}};
}

const int32_t* VisibilityScene::faces() const {
    return impl_->faces.data();
}

void VisibilityScene::occluded(const RayStream& rays, const float* distance, uint8_t* out) const {
    if (!impl_->packets) {
        for (int i = 0; i < rays.n; ++i)
            out[i] = occluded({rays.ox[i], rays.oy[i], rays.oz[i]},
                              {rays.dx[i], rays.dy[i], rays.dz[i]}, rays.t_min, distance[i]);
        return;
    }
    alignas(32) int valid[kPacket];
    RTCRay8 packet;
    for (int first = 0; first < rays.n; first += kPacket) {
        const int n = std::min(kPacket, rays.n - first);
        load(rays, first, packet, valid);
        std::copy_n(distance + first, n, packet.tfar);
        trace(valid, impl_->scene, packet);
        for (int k = 0; k < n; ++k) out[first + k] = valid[k] && packet.tfar[k] < 0;
    }
}

void VisibilityScene::closest_hit(const RayStream& rays, Hit* out) const {
    if (!impl_->packets) {
        for (int i = 0; i < rays.n; ++i)
            out[i] = closest_hit({rays.ox[i], rays.oy[i], rays.oz[i]},
                                 {rays.dx[i], rays.dy[i], rays.dz[i]}, rays.t_min);
        return;
    }
    alignas(32) int valid[kPacket];
    RTCRayHit8 packet;
    for (int first = 0; first < rays.n; first += kPacket) {
        load(rays, first, packet.ray, valid);
        std::fill_n(packet.hit.geomID, kPacket, RTC_INVALID_GEOMETRY_ID);
        std::fill_n(packet.hit.instID[0], kPacket, RTC_INVALID_GEOMETRY_ID);
        trace(valid, impl_->scene, packet);
        for (int k = 0; k < std::min(kPacket, rays.n - first); ++k) {
            const bool met = valid[k] && packet.hit.geomID[k] != RTC_INVALID_GEOMETRY_ID;
            out[first + k] = met ? Hit{packet.ray.tfar[k],
                                       packet.hit.u[k],
                                       packet.hit.v[k],
                                       static_cast<int64_t>(packet.hit.primID[k]),
                                       {packet.hit.Ng_x[k], packet.hit.Ng_y[k], packet.hit.Ng_z[k]}}
                                 : kNoHit;
        }
    }
}

#else  // without Embree every query is unreachable: there is no scene to ask

struct VisibilityScene::Impl {};

int embree_version() {
    return 0;
}

VisibilityScene::VisibilityScene(const float*, int64_t, const int32_t*, int64_t, int) {
    throw std::runtime_error("built without Embree");
}

bool VisibilityScene::occluded(const vec3<float>&, const vec3<float>&, float, float) const {
    return false;
}

Hit VisibilityScene::closest_hit(const vec3<float>&, const vec3<float>&, float, float) const {
    return {};
}

void VisibilityScene::occluded(const RayStream&, const float*, uint8_t*) const {}

void VisibilityScene::closest_hit(const RayStream&, Hit*) const {}

const int32_t* VisibilityScene::faces() const {
    return nullptr;
}

#endif

VisibilityScene::~VisibilityScene() = default;

void occluded(const VisibilityScene& scene, const RayBatch& rays, bool* out, int threads) {
    parallel_for(rays.n_rays, kRaysPerChunk, threads, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i)
            out[i] = scene.occluded(load3(rays.origin, i), load3(rays.direction, i), rays.t_min,
                                    rays.t_max);
    });
}

void closest_hit(const VisibilityScene& scene, const RayBatch& rays, float* t, int64_t* face,
                 float* barycentric, int threads) {
    parallel_for(rays.n_rays, kRaysPerChunk, threads, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) {
            const Hit hit = scene.closest_hit(load3(rays.origin, i), load3(rays.direction, i),
                                              rays.t_min, rays.t_max);
            t[i] = hit.t;
            face[i] = hit.face;
            barycentric[2 * i] = hit.u;
            barycentric[2 * i + 1] = hit.v;
        }
    });
}

}  // namespace univoxel
