# Charts of a mesh. Compiled once and without fused rounding: charts are the same on any processor. Not
# ours to be warned of, nor to be looked at by sanitizers.
find_package(Threads REQUIRED)
add_library(xatlas STATIC third_party/xatlas/xatlas.cpp)
target_include_directories(xatlas SYSTEM PUBLIC third_party/xatlas)
target_compile_options(xatlas PRIVATE -w -O3 -ffp-contract=off)
target_link_libraries(xatlas PUBLIC Threads::Threads)
