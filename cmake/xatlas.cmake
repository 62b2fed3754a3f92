# Charts of a mesh. Compiled once and without fused rounding: charts are the same on any processor.
# Not ours to be warned of, nor to be looked at by sanitizers.
find_package(Threads REQUIRED)
add_library(xatlas STATIC third_party/xatlas/xatlas.cpp)
target_include_directories(xatlas SYSTEM PUBLIC third_party/xatlas)
target_compile_options(xatlas PRIVATE -w -O3 -ffp-contract=off)
target_link_libraries(xatlas PUBLIC Threads::Threads)

# Of condition_variable::wait, libstdc++ has two versions, the newer of gcc 12: with that one a wheel
# would not run on RHEL 9. They differ in what they do when a thread is cancelled, and none is.
if(CMAKE_SYSTEM_NAME STREQUAL "Linux")
    set(wait _ZNSt18condition_variable4waitERSt11unique_lockISt5mutexE)
    file(CONFIGURE OUTPUT older_wait.h CONTENT "#include <cstddef>
#ifdef __GLIBCXX__
__asm__(\".symver ${wait}, ${wait}@GLIBCXX_3.4.11\");
#endif
")
    target_compile_options(xatlas PRIVATE -include ${CMAKE_CURRENT_BINARY_DIR}/older_wait.h)
endif()
