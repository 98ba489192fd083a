// Describe a photograph by `crisalad export --format openvino` (or onnx), without Python.
// describe PROGRAM HEIGHT WIDTH < PIXELS > DESCRIPTOR: RGB bytes in, row by row; float32 out.
#include <openvino/openvino.hpp>

#include <iostream>
#include <string>

int main(int, char** arguments) {
    ov::Core core;
    auto program = core.compile_model(arguments[1], "CPU", ov::hint::inference_precision(ov::element::f32));
    const size_t height = std::stoul(arguments[2]), width = std::stoul(arguments[3]);
    ov::Tensor images(ov::element::u8, {1, height, width, 3});
    std::cin.read(static_cast<char*>(images.data()), images.get_byte_size());
    auto request = program.create_infer_request();
    request.set_input_tensor(images);
    request.infer();
    const auto descriptor = request.get_output_tensor();
    std::cout.write(static_cast<const char*>(descriptor.data()), descriptor.get_byte_size());
}
